"""Database of a station's runs: unit, operator, files, steps, verdict and audit trail."""
