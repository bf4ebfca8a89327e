"""What a stranger adds, each in one file and from the documentation alone; the public suites judge it."""
