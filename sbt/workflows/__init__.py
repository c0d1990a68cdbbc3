"""What a user can ask for as a whole: run, merge, predict, compare, check."""
