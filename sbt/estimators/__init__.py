"""Estimators of a failure probability, and what they can and cannot say."""
