"""What a run leaves behind: tables, figures, one self-contained page, and result.json.

Everything is built in memory as bytes by name (`example_report.example_files`) and then written
whole or not at all (`write.write_files`).
"""
