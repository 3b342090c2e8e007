"""A run beside a reference."""
