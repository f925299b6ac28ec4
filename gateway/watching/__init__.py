"""The page of a run: what it shows is read from the learner while somebody watches."""
