"""Where next: samplers of concrete scenarios."""
