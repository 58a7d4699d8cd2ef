"""Pure tensor functions that the model is made of: no state, no settings."""
