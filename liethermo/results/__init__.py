"""Results of runs: time series and status, audits of the laws, files and pictures."""
