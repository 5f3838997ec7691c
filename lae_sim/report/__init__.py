"""What people look at: tables as text, CSV, LaTeX and HTML; figures, pages, films, timelines."""
