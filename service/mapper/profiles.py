"""Profile name -> its config and its assembly. The only module that knows methods by name."""
