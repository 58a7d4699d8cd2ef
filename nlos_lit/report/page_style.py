"""How the report looks: one style sheet, light, for screens, phones and paper."""

CSS = """
:root { color-scheme: light; --line: #ddd; --soft: #595959; }
* { box-sizing: border-box; print-color-adjust: exact; -webkit-print-color-adjust: exact; }
body { margin: 0 auto; padding: 1.2rem; max-width: 64rem; color: #1a1a1a; background: #fff;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { margin: .2rem 0 .6rem; padding: .1rem 0 .1rem .9rem; font-size: 1.45rem; line-height: 1.3;
  border-left: .4rem solid; }
h1.fine { border-color: #009E73; } h1.found { border-color: #0072B2; }
h1.unexplained { border-color: #D55E00; }
ol { padding-left: 1.6rem; } li { margin: .2rem 0; } header li { font-size: 1.1rem; }
h2 { margin: 2.2rem 0 .6rem; font-size: 1.1rem; border-bottom: 1px solid var(--line); }
small, figcaption, .over { color: var(--soft); font-size: .85rem; }
.over { margin: 0; }
.next h2, header h2 { margin: 1rem 0 .2rem; border: 0; font-size: 1.02rem; }
.next h2 + p, header h2 + p { margin-top: 0; }
.next { border: 1px solid #0072B2; border-radius: .3rem; padding: .1rem 1rem .4rem; background: #f3f8fc; }
.next pre { white-space: pre-wrap; overflow-wrap: anywhere; }
.next pre { background: #fff; border: 1px solid var(--line); padding: .4rem .6rem; }
a { color: #005b8f; }
.term { font-style: normal; border-bottom: 1px dotted #444; cursor: help; position: relative; }
.term:hover::after, .term:focus::after { content: attr(data-says); position: absolute; z-index: 2; left: 0;
  top: 1.6em; width: min(20rem, 70vw); padding: .5rem .7rem; background: #1a1a1a; color: #fff;
  font-size: .85rem; font-weight: 400; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem .35rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line); }
th { color: var(--soft); font-weight: 600; font-size: .82rem; }
td small { display: block; }
figure { margin: 1rem 0; break-inside: avoid; }
figure img { max-width: 100%; height: auto; display: block; }
.bar { display: flex; height: 1.6rem; border: 1px solid #999; }
.bar span, .keys i { display: block; }
.noise { background: #d9d9d9; } .explained { background: #0072B2; } .unexplained { background: #D55E00; }
.within { background: #bdbdbd; }
h1.unexplained { background: none; }
.keys { display: flex; flex-wrap: wrap; gap: .2rem 1.4rem; margin: .35rem 0; font-size: .92rem; }
.keys span { display: flex; align-items: center; gap: .4rem; }
.keys i { width: .9rem; height: .9rem; }
dt { font-weight: 600; margin-top: .6rem; } dt small { font-weight: 400; }
dd { margin: 0; } dd b { font-weight: 600; }
@media (max-width: 44rem) {
  body { padding: .8rem; } h1 { font-size: 1.2rem; }
  .cards thead { display: none; } .cards, .cards tbody, .cards tr, .cards td { display: block; }
  .cards td { border: 0; padding: .15rem 0; }
  .cards tr { border-bottom: 2px solid var(--line); padding: .5rem 0; }
  .cards td::before { content: attr(data-label) " "; display: block; color: var(--soft); font-size: .78rem; }
}
@media print {
  body { max-width: none; padding: 0; font-size: 11pt; }
  .wide { overflow: visible; }
  h2 { break-after: avoid; }
}
"""
