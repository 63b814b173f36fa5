"""How far a graph is from another, and which modules and nodes int8 hurts."""
