"""Certificates: what a finished search proves, saved to disk, and an independent check of it."""

from dcreg.certificate.format import Certificate, CertificateError, read, write
from dcreg.certificate.verification import Report, verify

__all__ = ["Certificate", "CertificateError", "Report", "read", "verify", "write"]
