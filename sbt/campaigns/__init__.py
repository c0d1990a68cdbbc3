"""The campaigns: functions that build the stages of one, and what it concludes."""
