"""The material point method: transfers, constitutive laws, boundaries and the solver."""
