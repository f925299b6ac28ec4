"""An actor's session with a learner: joining, uploading rollouts, receiving snapshots, reconnecting."""
