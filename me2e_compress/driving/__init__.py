"""The contract of driving: what a policy sees and says, and what a decision costs."""
