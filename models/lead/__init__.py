"""LEAD's driving model, TransFuser v6, in torch at its published dimensions."""
