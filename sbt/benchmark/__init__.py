"""Comparisons: the paper's experiment, and other samplers on the same scenario and budget."""
