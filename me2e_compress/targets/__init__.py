"""What a graph must look like for the program that will run it."""
