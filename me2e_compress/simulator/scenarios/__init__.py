"""44 scenario types after Bench2Drive's: a layout and an actor script each."""
