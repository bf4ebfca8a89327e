"""How the definition of a step becomes fast code."""
