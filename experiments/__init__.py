"""Experiments that make the tables, the shipped data and the shipped checkpoints."""
