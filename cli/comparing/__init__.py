"""Statistics of several runs, and what reads, groups and shows them."""
