"""What made the tables, the shipped data and the shipped checkpoints."""
