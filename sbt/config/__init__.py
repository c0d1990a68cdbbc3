"""Configurations: YAML to checked models, models to a scenario, a metamodel and an acquisition."""
