"""What serves the actors: joins, intake, buffers, publishing."""
