"""The 44 types, a file for each of Bench2Drive's abilities."""
