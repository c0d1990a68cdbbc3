"""Safety metrics: functions of a trace, computed after the run."""
