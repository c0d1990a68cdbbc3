"""What is asked: inputs and their law, scenarios, traces, metrics, requirements, outcomes."""
