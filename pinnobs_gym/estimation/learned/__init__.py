"""What learned estimators share: networks, their files, the dynamics and maps of KKL observers."""
