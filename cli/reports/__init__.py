"""The report of one or more runs: what their directories record, as one HTML file or as a model card."""
