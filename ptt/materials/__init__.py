"""Materials: shapes of BRDFs and the spaces between them; analytic, measured and tabulated."""
