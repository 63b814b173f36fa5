"""The commands, one file each: its options, one call of a workflow, its output."""
