"""Pages for people: self-contained HTML with charts, made from what other packages found out."""
