"""What all commands share: errors as sentences, progress, memory, steps that are kept."""
