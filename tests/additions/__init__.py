"""Extensions that a stranger writes, each in one file and from the documentation alone; the public suites judge it."""
