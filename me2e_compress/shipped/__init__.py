"""What ships: trained drivers with their cards, and recorded frames of theirs."""
