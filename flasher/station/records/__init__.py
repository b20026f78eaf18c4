"""The records of a station: what was done to which unit, by whom, with which file."""
