"""Programs and what runs them: how a policy is exported, and how an actor plays it."""
