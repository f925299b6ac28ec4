"""The league of a run: who plays whom in its game, how strong they are, and the kept versions of the policy."""
