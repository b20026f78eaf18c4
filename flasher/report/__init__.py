"""Reports: self-contained HTML pages with charts, and JUnit XML."""
