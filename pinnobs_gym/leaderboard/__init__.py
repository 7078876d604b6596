"""What many stored scores say together: standings, ranks, suites of jobs, and the page."""
