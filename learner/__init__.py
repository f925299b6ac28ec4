"""The learner process: settings, training, serving of actors, reporting. Never imports the actor."""
