"""How fast, how accurate, and which way: errors, costs, search and plans."""
