"""Where one cloud lies on another, without a guess: matches of features, and a covering of SO(3)."""
