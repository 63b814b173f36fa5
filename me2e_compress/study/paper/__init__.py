"""The paper's tables, figures and findings, asked again of a driver of one's own."""
