"""The reference stacks and the driver in torch, with what exports and trains them."""
