-- Questions about a fleet, a statement each: pdhef query OUT "SELECT ...", or DuckDB with a view of each file:
-- CREATE VIEW drives AS SELECT * FROM 'OUT/tables/drives.parquet'

-- How many drives and hours ended how?
SELECT outcome, COUNT(*) AS drives, SUM(seconds) / 3600 AS hours FROM drives GROUP BY outcome ORDER BY drives DESC;

-- How large is the sideslip error by car?
SELECT car, COUNT(sideslip_rmse_rad) AS scored, DEGREES(MEDIAN(sideslip_rmse_rad)) AS median_deg,
       DEGREES(QUANTILE_CONT(sideslip_rmse_rad, 0.9)) AS p90_deg
FROM drives GROUP BY car ORDER BY median_deg DESC;

-- Which drives are the worst?
SELECT log, DEGREES(sideslip_rmse_rad) AS rmse_deg, car, day, route, failed_checks
FROM drives WHERE sideslip_rmse_rad IS NOT NULL ORDER BY sideslip_rmse_rad DESC LIMIT 20;

-- In which drives is the selected estimate worse than zero sideslip?
SELECT d.log, DEGREES(d.sideslip_rmse_rad) AS rmse_deg, DEGREES(m.value) AS zero_deg
FROM drives AS d JOIN metrics AS m ON d.log = m.log
WHERE m.estimator = 'zero' AND m.signal = 'sideslip_rad' AND m.segment = 'all' AND m.metric = 'rmse'
  AND m.independent AND d.sideslip_rmse_rad > m.value
ORDER BY rmse_deg DESC;

-- Which estimator is the best at the limit of adhesion?
SELECT estimator, COUNT(value) AS drives, DEGREES(MEDIAN(value)) AS median_deg FROM metrics
WHERE signal = 'sideslip_rad' AND segment = 'nonlinear' AND metric = 'rmse' AND independent
GROUP BY estimator ORDER BY median_deg;

-- Why did logs fail?
SELECT reason, COUNT(*) AS logs FROM drives WHERE outcome = 'failed' GROUP BY reason ORDER BY logs DESC;

-- What is lost of the logs?
SELECT kind, COUNT(DISTINCT log) AS drives, SUM(count) AS samples FROM faults
WHERE origin = 'log' AND severity = 'lost' GROUP BY kind ORDER BY drives DESC;

-- Which checks fail most often?
SELECT name, COUNT(*) AS drives FROM checks WHERE verdict = 'failed' AND NOT waived
GROUP BY name ORDER BY drives DESC;

-- What is the evidence of a failed check, by drive?
SELECT c.log, d.car, c.name, c.evidence, c.remedy FROM checks AS c JOIN drives AS d ON c.log = d.log
WHERE c.verdict = 'failed' AND NOT c.waived ORDER BY c.log;

-- Where is the 95 % interval too narrow?
SELECT log, estimator, sideslip_coverage95 FROM drives WHERE sideslip_coverage95 < 0.9 ORDER BY sideslip_coverage95;

-- Which sensors are faulty?
SELECT place, kind, COUNT(DISTINCT log) AS drives, SUM(count) AS times, SUM(seconds) AS seconds FROM faults
WHERE origin = 'sensor' GROUP BY place, kind ORDER BY drives DESC;

-- How long and how well was each speed driven?
SELECT speed_m_s, SUM(seconds) / 3600 AS hours,
       DEGREES(SQRT(SUM(sideslip_mse_rad2 * scored) / SUM(CASE WHEN sideslip_mse_rad2 IS NULL THEN 0 ELSE scored END)))
           AS rmse_deg
FROM exposure GROUP BY speed_m_s ORDER BY speed_m_s;

-- Which cars were driven at the limit, and how long?
SELECT d.car, SUM(e.seconds) / 60 AS minutes FROM exposure AS e JOIN drives AS d ON e.log = d.log
WHERE e.ay_m_s2 >= 4 AND e.speed_m_s >= 15 GROUP BY d.car ORDER BY minutes DESC;

-- Which manoeuvres are there?
SELECT event, COUNT(*) AS times, COUNT(DISTINCT log) AS drives, AVG(seconds) AS mean_s FROM events
GROUP BY event ORDER BY times DESC;

-- How large is the error of the selected estimate by manoeuvre?
SELECT m.segment, COUNT(m.value) AS drives, DEGREES(MEDIAN(m.value)) AS median_deg
FROM metrics AS m JOIN drives AS d ON m.log = d.log AND m.estimator = d.estimator
WHERE m.signal = 'sideslip_rad' AND m.metric = 'rmse' AND m.independent GROUP BY m.segment ORDER BY median_deg DESC;

-- Does the error change from month to month?
SELECT SUBSTR(day, 1, 7) AS month, COUNT(sideslip_rmse_rad) AS scored, DEGREES(MEDIAN(sideslip_rmse_rad)) AS median_deg
FROM drives GROUP BY SUBSTR(day, 1, 7) ORDER BY month;

-- Does an entry of the metadata separate the drives?
SELECT t.value, COUNT(d.sideslip_rmse_rad) AS scored, DEGREES(MEDIAN(d.sideslip_rmse_rad)) AS median_deg
FROM metadata AS t JOIN drives AS d ON t.log = d.log WHERE t.key = 'road' GROUP BY t.value ORDER BY median_deg DESC;

-- In which drives did an estimator diverge?
SELECT log, event, SUM(seconds) AS seconds FROM events WHERE event LIKE '% diverged'
GROUP BY log, event ORDER BY seconds DESC;

-- Which requirements does the run miss, and in how many drives?
SELECT requirement, outcome, COUNT(log) AS drives, COUNT(*) - COUNT(log) AS of_run FROM verdicts
GROUP BY requirement, outcome ORDER BY requirement, outcome;

-- Which drives were recorded twice?
SELECT signals_sha256, COUNT(*) AS times, MIN(log) AS first_log, MAX(log) AS last_log FROM drives
WHERE signals_sha256 IS NOT NULL GROUP BY signals_sha256 HAVING COUNT(*) > 1 ORDER BY times DESC;
