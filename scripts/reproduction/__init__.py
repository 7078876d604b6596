"""The paper's tables and examples made anew: what it prints, how a case is run, and the report."""
