"""Matrix Lie groups and the maps between a group and its algebra."""
