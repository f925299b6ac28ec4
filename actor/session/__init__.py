"""The conversation of an actor with its learner: join, upload, snapshots, reconnect."""
