"""What is measured: models, their frames, and what makes them."""
