"""Style sheet of reports, for light and dark, narrow and wide screens."""

STYLE = """
:root{--ink:#1d2730;--paper:#fff;--soft:#5b6873;--line:#d5dbe0;--a:#c2314b;--b:#1b6f9c;--warn:#fff4d6;--edge:#b98900}
@media (prefers-color-scheme:dark){:root{--ink:#e3e8ec;--paper:#14191e;--soft:#9aa8b3;--line:#36414b;--a:#ff7d90;
--b:#6cc3ef;--warn:#332a10;--edge:#d9a514}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:1120px;margin:0 auto;padding:24px 20px 64px}
h1{font-size:1.7rem;line-height:1.2;margin:.2em 0 .4em}
h2{font-size:1.25rem;margin:2em 0 .4em}
p{max-width:75ch}
li{overflow-wrap:anywhere}
table{border-collapse:collapse;font-size:.92rem}
th,td{padding:6px 12px 6px 0;text-align:left;vertical-align:middle;border-bottom:1px solid var(--line)}
thead th{color:var(--soft);font-weight:600}
tbody th{font-weight:600;max-width:26ch}
td{overflow-wrap:anywhere;min-width:9ch}
td.number{white-space:nowrap;font-variant-numeric:tabular-nums}
small{color:var(--soft);font-weight:400}
.wide{overflow-x:auto}
.verdict{max-width:85ch;padding-left:1.2em}
.verdict li:first-child{font-size:1.15rem;font-weight:600}
.pixels{fill:var(--soft);stroke:var(--paper);stroke-width:1.5}
.warning,.note{border-left:5px solid var(--edge);background:var(--warn);padding:2px 16px 4px;margin:16px 0}
.warning h2,.note h2{font-size:1.05rem;margin:.5em 0 0}
.note{border-color:var(--line);background:none}
figure{margin:0 0 12px;min-width:0}
figure img{display:block;width:100%;height:auto;border-radius:3px;image-rendering:pixelated}
figcaption{font-size:.82rem;color:var(--soft);overflow-wrap:anywhere}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:4px 20px}
.views{display:grid;grid-template-columns:1fr 1fr 1fr;gap:4px 20px;max-width:960px}
@media (max-width:640px){.pair,.views{grid-template-columns:1fr}}
@media (max-width:760px){.scores :is(table,tbody,tr,th,td){display:block;max-width:none}.scores thead{display:none}
.scores :is(th,td){border:0;padding:2px 0}.scores tr{border-bottom:1px solid var(--line);padding:8px 0}
.scores td[data-name]::before{content:attr(data-name) ": ";color:var(--soft)}.scores td.number{white-space:normal}}
svg{max-width:100%;height:auto;color:var(--ink)}
svg text{fill:var(--soft);font-size:12px}
.zero{font-size:9px;fill:var(--soft)}
.axis,.grid{stroke:var(--line);stroke-width:1.5}
.interval{stroke:var(--a);stroke-width:6;stroke-opacity:.45;stroke-linecap:round}
.real{stroke:var(--b);stroke-width:2.5;stroke-dasharray:4 3}
.dot{fill:var(--a);stroke:var(--paper);stroke-width:1.5}
.chart{width:100%;max-width:820px}
.line{fill:none;stroke-width:2.2}
.line0{stroke:var(--a)}
.line1{stroke:var(--b);stroke-dasharray:6 4}
.key0{color:var(--a);font-weight:600}
.key1{color:var(--b);font-weight:600}
summary{cursor:pointer;padding:4px 0}
:focus-visible{outline:3px solid var(--b);outline-offset:2px}
pre{overflow:auto;max-height:480px;font-size:.78rem;border:1px solid var(--line);padding:12px}
.swatch{display:inline-block;width:1em;height:1em;border:1px solid var(--soft);vertical-align:-.15em}
"""
"""The style sheet; it names no file and no font that a computer may lack."""
