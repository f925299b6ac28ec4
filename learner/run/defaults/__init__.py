"""Default settings for each kind of spaces, for environments without a preset."""
