"""What programs see of a database, wherever it is: a protocol and frozen values."""
