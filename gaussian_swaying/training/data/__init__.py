"""What a training sees."""
