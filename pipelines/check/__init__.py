"""`check`: go or no-go before the crew leaves the field."""
