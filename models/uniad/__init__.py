"""UniAD-tiny in torch, at its published dimensions."""
