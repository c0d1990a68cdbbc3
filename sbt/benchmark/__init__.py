"""The paper's experiment: metamodels x acquisitions x scenarios x seeds, scored on random reference runs."""
