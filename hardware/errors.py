"""The one exception family of the project, kept in the lowest layer that raises it."""


class SonarError(ValueError):
    """Input or a call that cannot be used.

    The message is one line: what came, what is allowed, and where (file, row, column or key). The command line prints
    it as it stands and exits with code 2. Public as ``jaxsonar.SonarError``.
    """
