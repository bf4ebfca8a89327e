"""Functions of matrices that can be traced, batched and differentiated."""
