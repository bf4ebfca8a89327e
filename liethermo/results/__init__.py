"""What a run returns: its series and how it ended, the audit of its laws, files and pictures."""
