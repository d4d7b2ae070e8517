"""A camera from the paint in one image, without a click."""
