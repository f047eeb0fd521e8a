"""Where the subject is in a picture: given, by a key colour, by a clean plate, or by a program of the user's."""
