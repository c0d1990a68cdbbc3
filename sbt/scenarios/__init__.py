"""The built-in logical scenarios, one file each, as a user would write them."""
