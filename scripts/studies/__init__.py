"""Studies behind the tables and choices of the documentation; `scripts/bench` runs them."""
