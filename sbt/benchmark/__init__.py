"""The paper's experiment (metamodels x acquisitions x scenarios x seeds), and other samplers on the same budget."""
