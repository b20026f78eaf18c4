"""Commands for the database that collects the records of all stations of a plant."""
