"""Self-contained HTML pages with charts, and JUnit XML."""
