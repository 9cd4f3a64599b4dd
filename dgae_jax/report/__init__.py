"""From the files of studies to what people read: statistics, figures, tables, one page."""
