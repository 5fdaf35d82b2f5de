"""What people are told of their exercises: scores, figures, pages, limits, a curriculum."""
