"""Certificates: what a finished search proves, on disk, and its check apart from the search."""

from dcreg.certificate.format import Certificate, CertificateError, read, write
from dcreg.certificate.verification import Report, verify

__all__ = ["Certificate", "CertificateError", "Report", "read", "verify", "write"]
