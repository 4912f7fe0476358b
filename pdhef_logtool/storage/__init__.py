"""Files, folders, object stores and documents: complete or absent.

:mod:`~.outputs` replaces a folder atomically, :mod:`~.documents` writes and verifies documents with checksums. It must
not depend on their content: it imports only :mod:`~pdhef_logtool.records`.
"""
