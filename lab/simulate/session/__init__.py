"""Raw clips as a crew brings them home, and what may be wrong with them."""
