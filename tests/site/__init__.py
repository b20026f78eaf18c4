"""The site: what is drawn while Sphinx builds it, and what is held of the result."""
