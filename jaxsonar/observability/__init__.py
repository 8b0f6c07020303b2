"""What an array of sensors can observe: Cramer-Rao bounds and error rates of the kinds of reflectors."""
