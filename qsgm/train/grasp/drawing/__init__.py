"""How objects and tables are drawn: random fields, parts, shading, families of shapes."""
