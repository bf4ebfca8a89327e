"""The library in other people's tools: their calls with our systems and steps, and their descriptions of ours."""
