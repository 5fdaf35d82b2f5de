"""What all exercises share."""
