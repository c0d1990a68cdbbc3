"""What is asked: inputs and their distribution, scenarios, traces, metrics, requirements, outcomes."""
