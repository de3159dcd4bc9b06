"""The trial of the guard: hostile and honest learners in random loops beside MF-ESO."""
