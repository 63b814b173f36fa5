"""What is measured on frames: recorded inputs, observers, the ranges that follow."""
