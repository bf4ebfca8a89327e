"""What produces entropy: one construction a file, those between the bodies of a composed system too."""
