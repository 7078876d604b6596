"""Networks of learned estimators, their files, and the dynamics and maps of KKL observers."""
