"""The stages of the method: one file each, with its units, inputs and settings."""
