"""What does the simulation get wrong, and why? See docs/criticism.md."""
