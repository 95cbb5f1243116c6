"""How reports look."""

from __future__ import annotations

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#1a1a1a;background:#fff;max-width:1180px;
margin:0 auto;padding:1rem 1.5rem}
h1{font-size:1.6rem}h2{margin-top:2.4rem;border-top:2px solid #ddd;padding-top:1rem}
table{border-collapse:collapse;margin:.6rem 0}td,th{padding:.25rem .7rem;text-align:left;
border-bottom:1px solid #e5e5e5;vertical-align:top}td.n{text-align:right;
font-variant-numeric:tabular-nums}.charts{display:flex;flex-wrap:wrap;gap:1rem}
.charts figure{margin:0;flex:1 1 420px;max-width:560px}svg{width:100%;height:auto;
font:12px system-ui,sans-serif}svg .p{fill:none;stroke:#888}svg .g{stroke:#e5e5e5}
svg.m{max-width:760px;border:1px solid #ddd}.m .d{fill:#c4c4c4}.m circle.r{fill:#009e73}
.m circle.w{fill:#d55e00}.m line.r{stroke:#009e73}.m line.w{stroke:#d55e00;stroke-opacity:.55}
.m .b{stroke:#1a1a1a;stroke-width:2}.wide{overflow-x:auto}.grid td{padding:.3rem;border:0}
.grid img,.grid .none{width:180px;height:135px;object-fit:cover;display:block;border:5px solid}
.grid .none{background:#f2f2f2;color:#666;display:grid;place-items:center}
.grid .query{border-color:#0057d9}.grid .right{border-color:#128a3a}
.grid .wrong{border-color:#d32020}
.grid .missed{border-style:dashed}.grid small{display:block;max-width:190px;overflow-wrap:anywhere}
code{overflow-wrap:anywhere}figcaption,.note{color:#555;font-size:.9rem}
"""
