"""What one measurement knows of a surface: arrays with one, two, three and many receivers compared."""
