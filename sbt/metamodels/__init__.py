"""Metamodels and their predictions; the only place with torch and scikit-learn."""
