"""Registration without learning, by the libraries that people use, on the same pairs."""
