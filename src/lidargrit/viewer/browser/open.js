// The page that holds its own scans.

const page = new Page(JSON.parse(document.getElementById("scans").textContent));
page.go(0);
