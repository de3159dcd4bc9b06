"""Models from records."""
