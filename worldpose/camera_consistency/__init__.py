"""Detection and diagnosis of cameras that are inconsistent with the others."""
