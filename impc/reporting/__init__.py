"""Reports: tables, figures, one self-contained HTML page, and result.json.

Files are built in memory (`document.Report.files`) and written atomically (`writer.write_files`).
"""
