"""Sand: the friction of the Drucker-Prager law, layers on an incline, and columns that collapse."""
