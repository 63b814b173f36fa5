"""What drives a compressed model and scores the drive."""
