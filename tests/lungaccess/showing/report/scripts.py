"""What tests in the browser let a page do."""

from __future__ import annotations

PICTURE = (
    "window.lungaccessReport.set(arguments[0]); return document.getElementById(arguments[1]).toDataURL()"
)
CHOOSE = """const s = document.getElementById(arguments[0]);
s.value = arguments[1]; s.dispatchEvent(new Event('change'))"""
PROJECT = "return window.lungaccessReport.project(arguments[0])"
SLIDE = """const s = document.getElementById(arguments[0]);
s.value = arguments[1]; s.dispatchEvent(new Event('input'))"""
