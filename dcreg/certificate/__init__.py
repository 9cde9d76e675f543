"""Certificates: what a finished search proves, saved to disk, and an independent check of it."""

from dcreg.certificate.format import Certificate, CertificateError, read, write

__all__ = ["Certificate", "CertificateError", "read", "write"]
