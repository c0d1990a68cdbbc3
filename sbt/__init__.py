"""Scenario-based testing of automated vehicles on SUMO with probabilistic metamodels."""

__version__ = "0.1.0"
