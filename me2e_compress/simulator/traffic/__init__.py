"""Roads, vehicles and signals on highway-env's classes, before any scenario."""
