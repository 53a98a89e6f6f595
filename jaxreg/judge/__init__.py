"""Which of several poses is right, and how likely: one reading for ranking and verdict."""
