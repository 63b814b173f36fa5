"""The commands, one file each: what it takes, one call, what it shows."""
