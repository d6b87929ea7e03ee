// A page of the manual: its colours are those of the map's page.

import { setUpTheme } from "./theme.js";

setUpTheme(() => {});
